"""Boards and their tables: functions of records."""
