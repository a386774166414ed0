# Training; needs the extra `learn`.
