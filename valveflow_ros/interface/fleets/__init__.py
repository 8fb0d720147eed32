# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Many units and months on Dask."""
