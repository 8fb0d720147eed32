"""Say why the very first run takes longer."""

from __future__ import annotations

from valveflow_ros.report.first_run import SENTENCE, is_first_run

__all__ = ['SENTENCE', 'is_first_run']
