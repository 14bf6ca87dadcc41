"""The paper's scenarios through the very heart of the daemon, and what is found beside what the paper found."""
