"use strict";
// Styles that Bokeh makes, each in the root of a view, are ours: they get the page's nonce.
(() => {
  const nonce = document.currentScript.nonce;
  const make = document.createElement.bind(document);
  document.createElement = (tag, options) => {
    const element = make(tag, options);
    if (tag === "style") element.nonce = nonce;
    return element;
  };
})();
