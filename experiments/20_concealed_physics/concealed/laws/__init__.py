"""Laws that are in no catalogue, in four sets, each made when the search had been improved on the sets before."""
