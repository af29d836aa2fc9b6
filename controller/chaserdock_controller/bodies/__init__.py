# SPDX-License-Identifier: Apache-2.0
"""Mathematics of rigid bodies that all stages share: target, its shape, stacks with latched
chasers.
"""
