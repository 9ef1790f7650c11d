"""World models: the contract, and one package for each family."""
