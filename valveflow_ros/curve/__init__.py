# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The flow characteristic: evaluation, JSON, inversion, and comparison with a reference."""
