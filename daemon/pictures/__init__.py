"""Pictures for eyes; nothing is measured in them."""
