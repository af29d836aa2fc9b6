# SPDX-License-Identifier: Apache-2.0
"""Files for targets: meshes of the shipped satellites, and sheets of markers to print."""
