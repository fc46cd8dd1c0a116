"""What people read: tables, Markdown and the terminal, all of them functions of records."""
