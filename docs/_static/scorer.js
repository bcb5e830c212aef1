// Order of search results: pages for users first, then references, then pages for developers.
var Scorer = {
  score: ([docname, , , , score]) => {
    if (/^(reference|api)\//.test(docname)) return score / 4;
    if (/^(architecture|changelog|contributing|licences|security|speed|testing)$/.test(docname)) return score / 16;
    return score;
  },
  // What follows are the values that Sphinx uses itself; it takes all from here or none.
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
