"""An energy with an explicit braking distance for `safemr`, as a package of its own."""
