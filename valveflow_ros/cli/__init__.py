# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command `valveflow`. Nothing heavy is imported before a verb needs it, and ROS never."""
