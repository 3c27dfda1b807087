"""From one accepted point to the next: descent, search, acceptance, stopping."""
