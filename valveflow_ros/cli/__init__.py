# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command `valveflow`. Slow modules are imported only if a verb needs them; ROS never is."""
