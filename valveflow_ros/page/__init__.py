# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A page in the browser about running monitors; everything it shows comes from their messages."""
