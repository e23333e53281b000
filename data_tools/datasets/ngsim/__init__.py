"""Windows of dense traffic of the NGSIM programme, with lanes, stop lines and signal cycles."""
