# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The simulated plants: the paper's unit and thermal units, with effects to switch on."""
