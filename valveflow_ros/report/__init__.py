# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pictures and the HTML report: data in, HTML out; nothing here reads or writes files."""
