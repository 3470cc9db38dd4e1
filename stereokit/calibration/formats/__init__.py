"""Calibration files, a module per format."""
