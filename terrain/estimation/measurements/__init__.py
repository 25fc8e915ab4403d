"""From the streams of a run log to the rows that a filter measures, on one clock and with one delay."""
