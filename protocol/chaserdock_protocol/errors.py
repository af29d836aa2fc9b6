# SPDX-License-Identifier: Apache-2.0
"""Base class of errors for users: one line of text per fault, printed without a traceback."""


class ChaserdockError(Exception):
    """A request cannot be carried out. The text states what failed, where, and what is valid."""
