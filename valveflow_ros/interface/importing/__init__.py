# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""From historians to logs: tables, and servers with a history."""
