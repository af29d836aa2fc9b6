"""Work with recorded logs: open, repair, export, send again."""

from .reader import Log, open_log

__all__ = ["Log", "open_log"]
