"""Pictures of clouds: for the terminal, and whatever else can show points."""
