# SPDX-License-Identifier: Apache-2.0
"""Web viewer for running missions and for logs.

``snapshot`` and ``history`` hold the data, ``text``, ``plots`` and ``shapes`` format them, all
without viser. ``scene`` and ``page`` draw with viser on a server of ``server``. The data come from
``live`` or ``logged``.
"""
