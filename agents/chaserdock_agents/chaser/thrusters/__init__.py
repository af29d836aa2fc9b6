"""Thruster control of a chaser: allocation, pulse modulation, fault detection and self-test."""
