# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One module for each verb: `arguments` adds its options, `run` does it."""
