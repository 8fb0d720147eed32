# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads tables exported by historians: CSV, Excel and Parquet."""
