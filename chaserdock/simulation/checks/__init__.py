# SPDX-License-Identifier: Apache-2.0
"""Invariants of simulated flights: one class each for what must hold, whatever fails.

``FlightChecks`` reads every message of a flight when it is published. State that several checks
need is kept in a ``FlightView``. Each message then goes to the checks that read its type. The
checks see messages only and trust none of the processes: who commands follows from what the chasers
flew.

To add an invariant, write a subclass of ``Check`` and name it in ``flight_checks.CHECKS``.
docs/invariants.md is generated from the classes.
"""
