"""How pictures of drawn cameras compare with photographs, and what they cost."""
