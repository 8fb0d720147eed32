# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables of historians: CSV, Excel and Parquet."""
