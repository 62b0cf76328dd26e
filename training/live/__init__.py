"""Page in the browser on which scenes are changed by hand and the movement is planned anew."""
