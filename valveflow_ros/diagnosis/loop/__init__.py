# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of the valve of one control loop, from its command and its response."""
