"""What every floor uses: errors, launches, safe writing of files, text for consoles."""
