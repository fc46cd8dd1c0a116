"""Sandboxes for detectors of strangers: a launcher of workers, and plug-ins described in one."""
