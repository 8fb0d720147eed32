# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Signals: alignment of readings into rows, and units."""
