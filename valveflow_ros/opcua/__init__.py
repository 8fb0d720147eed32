# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""OPC UA: the mapping of nodes to signals, the link to a server, its history, and a server."""
