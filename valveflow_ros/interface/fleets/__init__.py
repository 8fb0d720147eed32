# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Processing of many units and months with Dask."""
