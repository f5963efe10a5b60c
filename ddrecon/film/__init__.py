"""Films: a sequence of runs, one a frame, each begun with the last, and all of one calibration."""
