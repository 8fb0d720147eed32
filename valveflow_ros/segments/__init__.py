# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Online detection of special segments, and the rolling window that keeps them."""
