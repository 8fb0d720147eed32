# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Joint fit of curve and dynamics, its uncertainty, and the manual step test."""
