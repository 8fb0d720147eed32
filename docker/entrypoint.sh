#!/bin/bash
# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
# The command of the container, in the environment of ROS and of the workspace.
set -e
source /opt/valveflow/install/setup.bash
exec "$@"
