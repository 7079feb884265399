"""What depth features add to frozen visual ones, and a score that is learnt."""
