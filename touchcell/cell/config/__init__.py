"""Cell files: schema, validation and the plan that follows from them."""
