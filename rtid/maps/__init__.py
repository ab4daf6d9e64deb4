"""Learned maps as files: writers, look-up tables, calibration formats, data sheets and priors."""
