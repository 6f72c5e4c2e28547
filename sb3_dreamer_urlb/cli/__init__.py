"""What ``sb3-dreamer-urlb`` runs."""
