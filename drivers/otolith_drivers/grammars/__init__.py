"""Grammars of what is written: how a text from outside enters it without becoming more than a text."""
