# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The terminal view of a monitor."""
