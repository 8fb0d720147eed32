# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One module per verb: `arguments` adds its options, `run` runs it."""
