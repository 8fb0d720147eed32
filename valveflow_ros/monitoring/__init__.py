# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The monitor: it turns rows into events, without a clock, files, threads or ROS."""
