"""The paper's tables, figures and claims on a frozen split, from one command.

What is run is laid out in `experiments`, in which order in `schedule`, and how long it takes in
`costs`; `carry` does it. Everything printed is computed by `evidence` from records alone.
"""
