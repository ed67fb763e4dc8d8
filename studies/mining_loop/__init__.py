"""Does a detector learn more from frames that its failures ask for than from as many drawn evenly?"""
