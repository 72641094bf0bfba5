"""The processes: command line, daemon, devices process and decode worker."""
