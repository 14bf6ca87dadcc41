"""How answers are made and sent, so that those who ask often, or read slowly, hinder nobody."""
