"""Which recorded episodes are odd: a watchdog on episodes of logs."""
