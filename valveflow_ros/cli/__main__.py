# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""So that ``python -m valveflow_ros.cli`` is the command."""

import sys

from valveflow_ros.cli.main import main

if __name__ == '__main__':
    sys.exit(main())
