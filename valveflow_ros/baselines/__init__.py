# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The methods with which the paper compares, and the test of models on other data."""
