"""How far a direction is from the certified one."""
