"""Whether sky and air look as they do in photographs, by numbers."""
