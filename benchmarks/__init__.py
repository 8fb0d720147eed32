# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is fast, and how far results are from the truth: measured, not asserted."""
