# SPDX-License-Identifier: Apache-2.0
"""Does a foreign process keep the protocol? It is run against a recorded log, and all that it says is checked."""
