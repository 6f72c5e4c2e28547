"""Run folders: what a run that goes on is made of, and how it goes on."""
