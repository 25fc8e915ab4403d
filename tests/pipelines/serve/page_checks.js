// What is asked of the page: a function each, by its name, made an attribute of the window.

// The lowest contrast of all text that is seen, and where.
window.lowestContrast = () => {
  const linear = (v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  const light = (text) => {
    const [r, g, b] = text.match(/[\d.]+/g).slice(0, 3).map((v) => linear(v / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const back = (node) => {
    for (; node; node = node.parentElement) {
      const colour = getComputedStyle(node).backgroundColor;
      if (!/, 0\)$/.test(colour) && colour !== "transparent") return colour;
    }
    return "rgb(255, 255, 255)";
  };
  return [...document.querySelectorAll("body *")].filter((node) =>
    node.checkVisibility() && [...node.childNodes].some((one) => one.nodeType === 3 && one.data.trim())
  ).map((node) => {
    const [a, b] = [light(getComputedStyle(node).color), light(back(node))].sort();
    return [(b + 0.05) / (a + 0.05), node.id || node.tagName, node.textContent.slice(0, 30)];
  }).sort((a, b) => a[0] - b[0])[0];
};

// Number of colours of a canvas.
window.inkOf = (canvas) => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const seen = new Set();
  for (let k = 0; k < data.length; k += 4) if (data[k + 3]) seen.add(data.slice(k, k + 3).join());
  return seen.size;
};
