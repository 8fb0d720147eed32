# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The exact partition of samples into straight pieces, and the choice of their number."""
