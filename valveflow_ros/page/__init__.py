# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A web page about running monitors; all of its content comes from their messages."""
