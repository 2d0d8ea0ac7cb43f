"""The prompt optimizer ``plan``: learns a model of the task from all episodes, plans in it, and searches
for prompts that make the policy follow the plan."""
