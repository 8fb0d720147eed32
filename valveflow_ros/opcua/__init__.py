# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""OPC UA: mapping of nodes to signals, client with history access, and server of results."""
