"""Evaluation of missions in one process, against ground truth: no code here flies."""
