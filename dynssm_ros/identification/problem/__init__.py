"""What is fitted to what: simulations of recordings, their noise, and the car as a fit moves it."""
