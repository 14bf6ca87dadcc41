"""The paper's scenarios through the daemon's core, compared with the truth and with the paper (``make paper``)."""
