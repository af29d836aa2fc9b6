# SPDX-License-Identifier: Apache-2.0
"""Web viewer of running missions and logs.

``snapshot`` and ``history`` hold the data; ``text``, ``plots`` and ``shapes`` format them; none of
these uses viser. ``scene`` and ``page`` draw with viser on a server of ``server``. The data come
from ``live`` or ``logged``.
"""
