"""An own prompt optimizer: a model of the task from everything seen, plans in it, prompts for the plans."""
