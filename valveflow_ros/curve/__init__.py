# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The flow characteristic: evaluated, written, inverted, and compared with a reference."""
