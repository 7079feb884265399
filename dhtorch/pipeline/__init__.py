"""Methods: stages joined to pairs, several views and streams, and dense completion."""
