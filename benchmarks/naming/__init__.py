# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A benchmark for naming the cause where a simulation and measured data differ."""
