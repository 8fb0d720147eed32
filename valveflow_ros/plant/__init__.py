# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The simulated plant: the paper's unit, with effects to switch on."""
