# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Special segments: found while the data stream by, and the rolling window that keeps them."""
