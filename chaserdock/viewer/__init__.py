"""The web viewer: one page for a running mission and for a recorded log.

``now`` and ``history`` hold what the messages say, ``words`` and ``plots`` what the page tells of it, all without a
browser; ``stage`` and ``page`` draw with viser, which ``server`` opens; ``live`` and ``logged`` are its two sources.
"""
