"""The paper's tables, figures and claims on a frozen split, from one command.

`experiments` and `claims` read what the paper shows and claims; `page` renders it from records.
"""
