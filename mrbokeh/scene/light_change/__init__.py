"""How virtual objects change the light of the photograph around them: shadows, reflections, bounced light."""
