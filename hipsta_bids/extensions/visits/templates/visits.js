"use strict";
// One visit at a time in the same place: windows onto the maps that lie side by side below.
for (const side of document.currentScript.parentElement.querySelectorAll(".visits")) {
  const visits = JSON.parse(side.dataset.visits), maps = JSON.parse(side.dataset.maps);
  const step = side.querySelector(".step"), range = step.querySelector("input"), name = step.querySelector("output");
  const crop = (image, pair) => {
    const copy = pair.appendChild(document.createElement("div")).appendChild(image.cloneNode());
    const width = parseFloat(image.style.getPropertyValue("--width")) / 100;
    return ([left, right], text) => {
      copy.parentElement.style.width = `${width * (right - left)}px`;
      copy.style.marginLeft = `${-width * left}px`;
      copy.alt = text;
    };
  };
  const windows = [...side.querySelectorAll(".picture img")].map((image, n) => {
    const pair = step.lastElementChild.appendChild(document.createElement("div"));
    const title = image.nextElementSibling.textContent, map = crop(image, pair);
    crop(image, pair)([maps[n].at(-1)[1], 100], `Colors of ${title.toLowerCase()}`);
    return (visit) => map(maps[n][visit], `${title}, ${visits[visit]}`);
  });
  range.oninput = () => {
    for (const show of windows) show(range.value);
    name.textContent = visits[range.value];
    range.setAttribute("aria-valuetext", name.textContent);
  };
  range.oninput();
  step.hidden = false;
}
