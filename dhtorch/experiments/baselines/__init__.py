"""The same seats filled by other libraries: oracles for the tests, alternatives for the user."""
