# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The running monitor under load: who sends, who counts, and what is tried."""
