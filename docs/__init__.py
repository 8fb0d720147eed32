# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The handbook, and the programs that make its tables and pictures."""
