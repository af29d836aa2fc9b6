# SPDX-License-Identifier: Apache-2.0
"""Mass properties identified in flight: of the stack of target and latched chasers, and of a free
tumble (docs/detumble.md).
"""
