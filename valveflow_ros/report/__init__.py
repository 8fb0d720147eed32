# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures and the HTML report: data in, HTML out; no module here reads or writes logs."""
