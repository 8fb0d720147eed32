# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The methods the paper compares with, and how models are judged on other data."""
