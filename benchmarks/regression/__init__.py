# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compares the speed of this tree with that of an earlier one."""
