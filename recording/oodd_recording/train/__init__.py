"""Training of nominal policies, a program beside the harness, which records with frozen ones."""
