# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Import of logs from tables and from historian servers."""
