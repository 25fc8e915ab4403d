"""Whether the commands still compute what they did: cases, what they gave, and the comparison."""
