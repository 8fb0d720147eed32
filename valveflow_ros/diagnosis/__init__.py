# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the simulation gets wrong: the cause, the extended model, the gain."""
