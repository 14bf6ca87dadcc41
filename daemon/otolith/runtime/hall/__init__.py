"""The machines of a service and the processes that compute for all of them."""
