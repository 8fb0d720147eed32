"""Online identification and monitoring of main steam valve flow characteristics."""

__version__ = '0.1.0'
