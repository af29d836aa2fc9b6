"""The one family of errors that a person is to read: their text is one clear line a fault, and no traceback is shown."""


class ChaserdockError(Exception):
    """Something that was asked for cannot be done; the text says what, where and what would be right."""
