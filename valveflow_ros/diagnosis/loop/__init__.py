# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One control loop judged from its command and what follows it."""
