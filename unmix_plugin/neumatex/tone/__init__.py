"""From linear light to the numbers of a picture: fixed tone curves, and a camera response that is learnt."""
