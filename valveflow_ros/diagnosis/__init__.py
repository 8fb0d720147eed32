# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Diagnosis: the cause of a model error, the extended model and its gain in accuracy."""
