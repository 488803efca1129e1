const data = JSON.parse(document.getElementById('scene').textContent);
const cloud = {sent: unpack(data.sent), merged: unpack(data.merged), owners: words(data.owners)};
const kinds = {map: MapPicture, changes: ChangePicture};
const pictures = [...document.querySelectorAll('.stage')].map(
  stage => new kinds[stage.dataset.picture](stage, data, cloud));
