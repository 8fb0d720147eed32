# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Entry point of ``python -m valveflow_ros.cli``."""

import sys

from valveflow_ros.cli.main import main

if __name__ == '__main__':
    sys.exit(main())
