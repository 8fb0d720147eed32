# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The monitor: rows in, events out, without a clock, files, threads or ROS."""
